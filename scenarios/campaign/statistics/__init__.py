"""What a campaign's flights show, and with which confidence."""
