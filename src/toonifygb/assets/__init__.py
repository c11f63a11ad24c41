"""Files this project did not make: manifest, cache, converters."""
