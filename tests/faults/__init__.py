"""Commands that kill runs or train for long; pytest does not collect them."""
