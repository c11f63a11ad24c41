"""Stage 2: training the avatar against a tracked clip."""
