"""What a campaign's flights say, and how sure that is."""
