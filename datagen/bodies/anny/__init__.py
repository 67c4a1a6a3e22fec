"""Anny: people of all ages, licence-free."""
