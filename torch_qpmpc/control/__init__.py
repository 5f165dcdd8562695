"""Controllers for engineers: linear MPC with set-points, an observer and a last input."""
