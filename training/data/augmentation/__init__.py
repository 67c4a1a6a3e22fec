"""What changes a training batch at random before a network sees it."""
