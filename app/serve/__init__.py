"""The avatar in a browser: pictures are drawn here, and sent to a page over a WebSocket."""
