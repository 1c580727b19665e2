"""What is merged into another room next."""
