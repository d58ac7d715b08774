"""draccus, by which LeRobot parses command lines, without what takes it seconds."""

import inspect
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from types import SimpleNamespace

from draccus.wrappers import docstring, field_wrapper


@contextmanager
def parsed_quickly() -> Iterator[None]:
    """Keep draccus from looking for every flag's help text in source files, which takes seconds, and from
    inspecting the same few classes of argparse anew for every flag."""
    look_up, inspected = docstring.get_attribute_docstring, field_wrapper.inspect
    docstring.get_attribute_docstring = lambda *_: docstring.AttributeDocString()
    field_wrapper.inspect = SimpleNamespace(getfullargspec=cache(inspect.getfullargspec))
    try:
        yield
    finally:
        docstring.get_attribute_docstring, field_wrapper.inspect = look_up, inspected
