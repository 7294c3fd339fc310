"""Reports for people: figures, plots, films, recordings and pages made from flights."""
