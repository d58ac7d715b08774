"""What is said of a dataset's columns."""

from lerobot.configs import RGBEncoderConfig

from lerobot_wmrl.data.features import encoder_of

VIDEO = {"dtype": "video", "shape": (8, 8, 3)}


def test_the_encoder_is_that_of_pictures_also_where_depth_comes_first() -> None:
    depth = {**VIDEO, "info": {"is_depth_map": True, "video.codec": "hevc", "video.pix_fmt": "gray12le"}}
    colours = {**VIDEO, "info": {"video.codec": "h264", "video.pix_fmt": "yuv420p"}}
    for columns in ({"depth": depth, "top": colours}, {"top": colours}):
        assert encoder_of(columns) == RGBEncoderConfig.from_video_info(colours["info"])
    assert encoder_of({"depth": depth}) is None
