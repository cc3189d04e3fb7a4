"""Python launch files: read without being run, edited where it is safe."""
