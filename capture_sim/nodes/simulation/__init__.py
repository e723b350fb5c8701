"""The simulator and the player: play, pause, pace, step."""
