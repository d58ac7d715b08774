"""Studies: one YAML file a question; together they make every JSON in docs/results."""
