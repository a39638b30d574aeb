"""Networks in ONNX files that predict depth, flow, or where people are."""
