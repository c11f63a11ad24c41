"""Finding faces, their 478 landmarks and the head's matte."""
