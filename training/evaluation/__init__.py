"""Measuring a trained network: rows, tables, statistics, studies."""
