"""ASAM OSI: messages of frames, and the traces that hold them."""
