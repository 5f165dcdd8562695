"""Q-learning and its relatives for a QPMPC, in TorchRL."""
