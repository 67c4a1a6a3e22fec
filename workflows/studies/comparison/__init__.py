"""The paper's comparison and ablation: plan, run, report."""
