"""Reports as HTML and Markdown, dataset and model cards."""
