"""Studies of this repository: they call the packages, and none of these imports them."""
