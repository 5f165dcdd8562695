"""Tables of what users get wrong, by kind: the mistake, and how its message begins."""
