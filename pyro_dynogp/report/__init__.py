"""What a closed loop found, for a reader: sentences, figures, a page."""
