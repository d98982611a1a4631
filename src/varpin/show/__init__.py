"""Pictures: replays in meshcat, figures, tables of a robot."""
