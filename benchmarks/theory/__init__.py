"""What is possible: bounds, the paper's tables, what tuning finds."""
