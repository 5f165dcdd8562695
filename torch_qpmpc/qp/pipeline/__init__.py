"""The steps that solve and certify a batch of QPs; `solve` combines them."""
