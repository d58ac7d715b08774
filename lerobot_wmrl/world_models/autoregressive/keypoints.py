"""Keypoint consistency (RoboScape, section 2.3): a moving point keeps its look along its track.

RoboScape tracks dense points with SpatialTracker, keeps the K most active ones, and draws the visual tokens
predicted along their tracks to those of the first frame. Here tokens are the points, and block matching
of their codes is the tracker.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from lerobot_wmrl.common.precision import compute_in
from lerobot_wmrl.data.clips import known_transitions
from lerobot_wmrl.world_models.codebook import CodeBook
from lerobot_wmrl.world_models.losses import MOTION_LEVELS, masked_mean

KEYPOINTS = 16
"""K, the most active tracks a camera and clip. A gripper and an object cover about as many tokens."""

REACH = 1
"""How many tokens a track moves at most from one frame to the next, along each axis."""


class Tracks(NamedTuple):
    """Tracks of K keypoints through clips.

    places (B, T, K), the token where each keypoint is in each frame; moving (B, T, K), True where the frame
    is valid and the keypoint moves at all in the clip.
    """

    places: Tensor
    moving: Tensor


def surroundings(grid: int, num_cameras: int, device: torch.device) -> Tensor:
    """Return the tokens within `REACH` of each one in its camera's grid, itself first. (S, (2 REACH + 1)²)"""
    offset = torch.arange(-REACH, REACH + 1, device=device)
    shifts = torch.cartesian_prod(offset, offset)
    shifts = shifts[shifts.abs().sum(1).argsort(stable=True)]
    cell = torch.arange(grid, device=device)
    row, column = ((torch.cartesian_prod(cell, cell)[:, None] + shifts).clamp(0, grid - 1)).unbind(-1)
    camera = torch.arange(num_cameras, device=device)[:, None, None] * grid**2
    return (camera + row * grid + column).flatten(0, 1)


def track_tokens(codes: Tensor, codebook: CodeBook, around: Tensor) -> Tensor:
    """Track every token of the first frame: codes (B, T, S, C), `around` (S, N) → its place (B, T, S).

    Block matching: from frame to frame a track moves to the token around it whose codes are nearest to those
    at its start, if they are nearer by `MOTION_LEVELS` than where it is.
    """
    clip = torch.arange(len(codes), device=codes.device)[:, None, None]
    initial = codes[:, 0, :, None]
    places = [torch.arange(codes.shape[2], device=codes.device).expand(len(codes), -1)]
    for frame in codes[:, 1:].unbind(1):
        reachable = around[places[-1]]
        distance = codebook.distance(frame[clip, reachable], initial)
        distance[..., 0] -= MOTION_LEVELS - 1
        places.append(reachable.gather(-1, distance.argmin(-1, keepdim=True)).squeeze(-1))
    return torch.stack(places, 1)


def most_active(places: Tensor, valid: Tensor, num_cameras: int) -> Tracks:
    """Choose from tracks (B, T, S) the `KEYPOINTS` of each camera that change place most often.

    Each camera has its own: one on the wrist sees everything move. valid (B, T): frames of the episode.
    """
    moves = (places[:, 1:] != places[:, :-1]) & known_transitions(valid)[..., None]
    activity = moves.sum(1).unflatten(-1, (num_cameras, -1))
    order = activity.argsort(dim=-1, descending=True, stable=True)[..., :KEYPOINTS]
    first = torch.arange(num_cameras, device=places.device)[:, None] * activity.shape[-1]
    chosen = (order + first).flatten(1)[:, None].expand(-1, places.shape[1], -1)
    active = activity.gather(-1, order).flatten(1)[:, None] > 0
    return Tracks(places.gather(2, chosen), active & valid[..., None])


def keypoint_loss(
    logits: Tensor, codebook: CodeBook, codes: Tensor, valid: Tensor, num_cameras: int
) -> Tensor:
    """RoboScape's eq. 5: squared distance of the values expected along the tracks from those at their starts.

    logits (B, T − 1, S, V) of frames 1 … T − 1; codes (B, T, S, C) of all frames; valid (B, T) → scalar.
    Computed in float32, whatever the network computes in.
    """
    grid = math.isqrt(codes.shape[2] // num_cameras)
    around = surroundings(grid, num_cameras, codes.device)
    tracks = most_active(track_tokens(codes, codebook, around), valid, num_cameras)
    places = tracks.places[:, 1:, :, None]
    along = logits.gather(2, places.expand(-1, -1, -1, logits.shape[-1]))
    start = tracks.places[:, 0, :, None].expand(-1, -1, codebook.channels)
    initial = codebook.values(codes[:, 0]).gather(1, start)
    with compute_in(torch.float32, logits.device):
        apart = (codebook.expected_values(along.float()) - initial[:, None]).square().mean(-1)
    return masked_mean(apart, tracks.moving[:, 1:])
