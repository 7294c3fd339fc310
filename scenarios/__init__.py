"""What is flown: the scenario library, references, the runner and the command line."""
