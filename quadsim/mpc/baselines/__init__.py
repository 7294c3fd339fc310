"""What feedback laws share, to compare with MPC: a period of a law, attitudes, bandwidths, previews."""
