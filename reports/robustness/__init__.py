"""Commands that show how avatars bear views, expressions and drivers without ground truth."""
