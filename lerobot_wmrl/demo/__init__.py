"""The demo: real commands one after another, measured and resumable."""
