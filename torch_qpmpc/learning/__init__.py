"""Q-learning and related algorithms for a QPMPC, on TorchRL."""
