"""Studies: one YAML file a question; together they make every JSON in docs/results.

`run` runs a study, within a budget of real episodes. `steps` has what its commands run, and what collects
their results. `tables` writes docs/results.md from the JSON, by the sections in `page`.
"""
