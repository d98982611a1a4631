"""What logs say: sensitivities, identification, filter and smoother."""
