"""Frame tokenizer, spatial-temporal transformer, action and text world model, and their training."""
