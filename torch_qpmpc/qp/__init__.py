"""The QP layer: a batch of QPs, solved, certified, and differentiable; no module, no RL."""
