"""Fields, limits and messages that several tables `[controller]` of scenario files share."""
