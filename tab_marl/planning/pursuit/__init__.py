"""The interceptor: itineraries valued against sampled adversary paths, and the tree over changing them."""
