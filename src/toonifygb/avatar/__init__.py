"""The avatar: neutral Gaussians, expression deltas, skinning, mouth sets; and its file."""
