"""Stage 1: stylised video."""
