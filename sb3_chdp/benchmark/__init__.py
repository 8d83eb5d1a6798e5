"""Comparison of algorithms on anybody's environment, trained as rl_zoo3 trains them: ``sb3-chdp benchmark``."""
