"""The robot as skills see it, split by what each part owns."""
