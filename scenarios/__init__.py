"""The application: scenario library, references, the runner and the command line."""
