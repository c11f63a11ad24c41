"""Where the verbs meet: from a clip to an avatar, stage by stage, resumable."""
