"""What is learned: pose transfer, a person's template, a clothed avatar; each is a task of the same trainer."""
