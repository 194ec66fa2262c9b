"""Other programs that do the same work, used through their public interfaces."""
