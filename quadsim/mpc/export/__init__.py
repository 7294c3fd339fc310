"""Controllers as C99 for a flight computer: their numbers as text, and the files that they are compiled with."""
