"""Complete images: humans and opaque meshes over a background, in one of several views."""
