"""What users get wrong, and the one line that each of them reads."""
