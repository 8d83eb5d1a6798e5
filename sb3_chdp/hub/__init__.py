"""Trained models on the Hugging Face Hub. Importing its modules imports rl_zoo3."""
