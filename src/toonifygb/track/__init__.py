"""Explaining a clip's landmarks by a head model."""

from toonifygb.track.files import load, save
from toonifygb.track.fitting import fit

__all__ = ["fit", "load", "save"]
