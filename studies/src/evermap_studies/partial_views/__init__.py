"""What is told as changed where patrols see only part of a building."""
