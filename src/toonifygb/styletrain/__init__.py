"""A style of one's own: StyleGANEX taught to draw like a folder of pictures."""

from toonifygb.styletrain.loop import train_style

__all__ = ["train_style"]
