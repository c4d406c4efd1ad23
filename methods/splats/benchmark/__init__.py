"""Measurements of the splat renderer itself: speed, what accuracy costs, behaviour at numerical extremes."""
