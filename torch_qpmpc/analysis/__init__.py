"""Analysis of a learned QP: its predictions, its nearest model and its policy."""
