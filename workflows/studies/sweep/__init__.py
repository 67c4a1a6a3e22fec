"""Many trainings: plan, run, report."""
