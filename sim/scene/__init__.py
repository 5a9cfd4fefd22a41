"""What a world is built from: the object catalogue, rooms, and their compilation into one MuJoCo model."""
