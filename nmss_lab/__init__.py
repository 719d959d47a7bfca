"""Predictive control structures in the non-minimal state space."""

__all__ = ["__version__"]

__version__ = "0.1.0"
