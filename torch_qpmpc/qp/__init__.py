"""The QP layer: batches of QPs, solved, certified and differentiable; no modules and no RL."""
