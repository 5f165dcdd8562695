"""What a batch of QPs passes through, in order; `solve` puts the steps together."""
