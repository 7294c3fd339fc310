"""What a person looks at of a tuning: tables, figure, plots and page."""
