"""Typed recipes of training, networks and evaluation."""
