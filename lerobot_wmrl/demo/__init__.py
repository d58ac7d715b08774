"""The demo: console commands one after another, measured and resumable, and a report."""
