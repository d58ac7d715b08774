"""Driving a world model in the browser: a visitor's episode, who acts in it, and the page."""
