"""Networks that take points and images at once: the systems that the late cascade is compared with."""
