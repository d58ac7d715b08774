"""Silences the libraries that would talk over the progress bar."""

import logging

import av
import datasets


def silence_libraries() -> None:
    """FFmpeg's reports on every file, Hugging Face's progress bars, and LeRobot's information messages."""
    av.logging.set_libav_level(av.logging.ERROR)
    datasets.disable_progress_bars()
    logging.getLogger("lerobot").setLevel(logging.ERROR)
