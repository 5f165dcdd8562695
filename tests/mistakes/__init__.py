"""Tables of users' mistakes by kind, each with the beginning of its error message."""
