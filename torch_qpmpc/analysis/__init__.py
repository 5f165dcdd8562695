"""What a learned QP means: its predictions, its nearest model, its policy."""
