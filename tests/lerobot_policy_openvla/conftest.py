"""What the tests of this policy share."""

import pytest

from lerobot_policy_openvla.modeling_openvla import OpenVLAPolicy
from tests.lerobot_policy_openvla.reference import (
    WHOLE,
    Reference,
    excerpt_reference,
    whole_reference,
)


@pytest.fixture(scope="session", params=["excerpt", "whole"])
def reference(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Reference:
    """What the original code answers: the committed part, and all of it where it is at hand."""
    if request.param == "excerpt":
        return excerpt_reference(tmp_path_factory.mktemp("excerpt"))
    if not WHOLE.is_dir():
        pytest.skip("the whole reference checkpoint is not beside the repository; its excerpt was tested")
    return whole_reference()


@pytest.fixture(scope="session")
def original(reference: Reference) -> OpenVLAPolicy:
    """The reference's checkpoint, loaded."""
    return OpenVLAPolicy.from_openvla(reference.folder)
