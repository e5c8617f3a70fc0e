"""The pool file, read, checked and compared. Not here: the values of it (`fogft.model`)."""
