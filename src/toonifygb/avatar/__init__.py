"""The avatar: neutral Gaussians, expression deltas, skinning, mouth sets; and its file."""

from __future__ import annotations

from toonifygb.avatar.bases import Mixer, check_bases
from toonifygb.avatar.init import Views, init_avatar
from toonifygb.avatar.model import POSE_DRIVERS, Avatar, PoseDrivers
from toonifygb.avatar.mouth import MouthVolume
from toonifygb.avatar.player import Player
from toonifygb.avatar.poser import Poser
from toonifygb.avatar.save import load, save

__all__ = [
    "POSE_DRIVERS",
    "Avatar",
    "Mixer",
    "MouthVolume",
    "Player",
    "PoseDrivers",
    "Poser",
    "Views",
    "check_bases",
    "init_avatar",
    "load",
    "save",
]
