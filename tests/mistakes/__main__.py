"""Prints the page of mistakes, as the site has it: `python -m tests.mistakes`."""

from tests.mistakes.play import page

print(page())
