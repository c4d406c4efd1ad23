"""What a capture holds, on one picture and as numbers."""
