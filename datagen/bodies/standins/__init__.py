"""Licence-free body models in SMPL's and SMAL's file layout."""
