"""The one place that imports torch and onnxruntime: sessions, inert checkpoint reading, parameter filling."""
