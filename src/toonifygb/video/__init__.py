"""Frames in, frames out, streaming. The only room that imports av."""
