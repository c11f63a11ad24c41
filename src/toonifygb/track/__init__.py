"""Explaining a clip's landmarks by a head model."""
