"""hoverboard."""
