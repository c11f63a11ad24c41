"""Parts of the builder of the open head."""
