"""Chains data generation, training and evaluation; the only package that knows both of the others."""
