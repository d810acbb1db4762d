"""Cars, wheeled robots, multicopters and sensors that are turned by hand."""
