"""A person in clothes, learned from posed scans (FITE, Lin et al. 2022): field, correspondences, template, avatar."""
