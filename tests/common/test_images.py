"""Functions of images that policies and world models share."""

import torch

from lerobot_wmrl.common.images import coordinates, soft_positions


def test_soft_positions_are_where_a_map_is_high():
    maps = torch.full((1, 2, 5, 9), -20.0)
    maps[0, 0, 1, 8] = maps[0, 1, 4, 0] = 20.0
    rows, columns = coordinates(5, 9, maps)
    expected = [rows[1, 8], rows[4, 0], columns[1, 8], columns[4, 0]]
    torch.testing.assert_close(soft_positions(maps)[0], torch.stack(expected))
