"""How far a stream lies behind fresh reconstructions of its own frames."""
