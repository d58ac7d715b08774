"""Evaluation of world models on recorded episodes: open-loop replay, the gate, goal frames, policies."""
