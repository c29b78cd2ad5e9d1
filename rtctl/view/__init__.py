"""A robot seen live in a browser: what a ring or a log holds, drawn; and an operator's verbs, asked of the console."""
