"""Starting values."""
