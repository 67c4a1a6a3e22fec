"""Stages of a workflow, and what they run on."""
