"""How a human stands in pictures: where it starts from (`start`), how it is refined (`fit`), its file (`file`)."""
