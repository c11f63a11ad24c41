"""Head models with FLAME's functional interface."""
