"""An error is about the field that was given, in all of its text."""

import pytest

from lerobot_wmrl.common.errors import FieldError, renamed


@pytest.mark.parametrize("other", ["dataset.rooted", "policy.root"])
def test_only_the_field_itself_is_renamed_in_its_remedy_too(other: str) -> None:
    def message(field: str) -> str:
        with pytest.raises(FieldError) as raised, renamed("dataset.root", "starts.root"):
            raise FieldError(field, "/a", "empty, `dataset.root=/a`", "set `dataset.root` or `root`")
        return str(raised.value)

    assert message("dataset.root") == "starts.root=/a: empty, `starts.root=/a`; set `starts.root` or `root`"
    assert message(other) == f"{other}=/a: empty, `dataset.root=/a`; set `dataset.root` or `root`"


def test_all_fields_of_a_renamed_group_are_renamed() -> None:
    with pytest.raises(FieldError, match=r"^like.fps=5: .*`like.root`.*`datasets`"):  # noqa: SIM117
        with renamed("dataset", "like"):
            raise FieldError("dataset.fps", 5, "is not that of `dataset.root`", "see `datasets`")
