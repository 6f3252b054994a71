"""How groups of Gaussians are carried along before the residual is learned."""
