"""The pool file, read, checked and compared. Not here: its values (`fogft.model`)."""
