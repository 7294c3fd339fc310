"""What do constraints cost?  Flights and times measured, and the page's section made from them."""
