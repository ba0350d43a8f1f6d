"""Perceptions of the closed loop; `open_perception` of `dsrc.closed_loop.perception.open` makes them by name."""
