"""Users' mistakes by kind: the beginnings of error messages, and the calls that end in them."""
