"""Renderers: a readable reference, and the native CPU engine that must agree with it."""
