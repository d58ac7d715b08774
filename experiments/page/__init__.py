"""docs/results.md: its sections, tables and figures, made from the JSON in docs/results."""
