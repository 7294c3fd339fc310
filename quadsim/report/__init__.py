"""What a person looks at: figures, plots, films, recordings and pages made from flights."""
