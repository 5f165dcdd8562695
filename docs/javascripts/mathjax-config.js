window.MathJax = {
  tex: {inlineMath: [["\\(", "\\)"]], displayMath: [["\\[", "\\]"]]},
  options: {
    enableMenu: false, // its accessibility extensions would be fetched from elsewhere
    ignoreHtmlClass: ".*|",
    processHtmlClass: "arithmatex",
  },
};
