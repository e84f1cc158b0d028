def draw(results): return b""
