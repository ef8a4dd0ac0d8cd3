"""The board: who was scored, on which worlds, who checked it, and the page that shows it."""
