"""What each part of drawing an avatar of ours costs, and what each saving saves."""
